"""`ground compare`: grids of methods, sessions, seeds and conditions, trained, scored and drawn."""
