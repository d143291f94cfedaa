"""The flight software: takes exposure brackets, tags and stores frames, sends them down, obeys commands."""
