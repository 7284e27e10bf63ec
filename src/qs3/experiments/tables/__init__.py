"""One file a table or figure, with an ``EXPERIMENT``; its name is that of the file."""
