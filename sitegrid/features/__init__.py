"""Map contents as features: geometries with properties, as GeoJSON and GIS files."""
