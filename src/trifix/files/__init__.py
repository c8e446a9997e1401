"""Foreign conventions end here: what comes in metres, seconds and other people's layouts leaves in millimetres."""
