"""`ground view`: a model, its cameras and the pass on a page in the browser, for finished and growing runs."""
