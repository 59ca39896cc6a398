"""What a map shows as features: areas, lines and places with properties; as GeoJSON, and as files of GIS."""
