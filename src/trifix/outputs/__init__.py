"""Who looks at Steps: results on disk, the report."""
