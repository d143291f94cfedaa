"""What survives a power cut: the store of frames with its index, counters, settings, and the repair of all these."""
