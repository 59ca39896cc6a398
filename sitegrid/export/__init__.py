"""The map as files for GIS, CAD, notebooks and people; each is whole, or not there."""
