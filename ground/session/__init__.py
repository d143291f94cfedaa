"""Sessions: the folder of a pass with its frames, telemetry and truth, and the frames as the library takes them."""
