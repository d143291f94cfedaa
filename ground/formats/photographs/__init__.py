"""Photographs without poses or exposures: both are estimated from the pictures."""
