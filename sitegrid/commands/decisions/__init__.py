"""Commands by which a person decides something that the map server keeps."""
