"""Which frames are sent first, by the model that the ground has sent."""
