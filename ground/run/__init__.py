"""Runs: from a session to a trained and scored model, and the files of it."""
