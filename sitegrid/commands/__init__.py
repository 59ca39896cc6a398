"""One module per sub-command; each has `run(arguments) -> exit code`."""
