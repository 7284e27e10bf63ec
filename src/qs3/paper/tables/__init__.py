"""One file per table or figure, with a function ``experiment``; the file's name is the table's."""
