"""External methods, entered like anybody's: samples in, maps out."""
