"""Set-up on one laptop: what is on the ports, and a folder of site and machine files."""
