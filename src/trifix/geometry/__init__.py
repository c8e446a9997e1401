"""Mathematics on arrays. Knows no file and no screen; every formula names its source."""
