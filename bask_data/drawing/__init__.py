"""Pictures of artifacts as arrays and SVG, for the report, the viewer, videos and the documentation."""
