"""The dictionary of telemetry and commands as XTCE, for other ground systems."""
