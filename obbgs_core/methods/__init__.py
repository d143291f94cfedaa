"""The methods as settings: what they are, and which values make which method. Nothing here trains."""
