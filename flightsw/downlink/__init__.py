"""The loop that sends frames and telemetry and takes commands."""
