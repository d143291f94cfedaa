"""The commands of the ground station, a file a family; `ground.cli` puts them together."""
