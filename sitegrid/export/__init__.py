"""The map as files for GIS, CAD, notebooks and people; each file is complete or missing."""
