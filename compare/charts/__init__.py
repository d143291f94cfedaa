"""The page and the charts of a comparison, and what its rows say together."""
