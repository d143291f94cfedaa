"""The model that grows while a pass goes on."""
