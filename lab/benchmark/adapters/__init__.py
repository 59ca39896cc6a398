"""Methods from outside of this project, entered like anybody's: they read samples and write maps."""
