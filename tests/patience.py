"""How long a test waits for what has to come. It stops a hang, also on a machine that does much else: no test judges
how fast anything is."""

PATIENCE_S = 300.0
