"""What is wrong with this host's part of a site: probes, and checks of what they found."""
