"""Data sets and sessions in the formats of other tools: readers and writers."""
