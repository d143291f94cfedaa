"""The link with the spacecraft: receiving a pass, sending commands, and passing packets on to other ground systems."""
