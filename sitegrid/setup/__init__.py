"""What a user sets up on one laptop: what talks on its ports, and a folder with the files of a site and a machine."""
