"""What every part stands on: the root of our errors, files that appear whole, command lines that end alike."""
