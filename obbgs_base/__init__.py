"""What all parts share: the base class of errors, files written whole or not at all, start and end of commands."""
