"""Orbits, attitude, scenarios, navigation states and clock of the simulated world."""
