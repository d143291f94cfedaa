"""Servers of the simulated camera: on a socket, or as a GigE Vision camera."""
