"""Which parts of the field, loads and sensors the drift follows (level 4), and with what error probability."""
