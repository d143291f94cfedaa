"""The report of a run: one page, a section a module."""
