"""How right positions are: the paper's table, real logs, parity with robot_localization."""
