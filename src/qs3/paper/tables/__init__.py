"""One file per table or figure, with a function ``experiment``; the file's name is the table's.

`qs3.paper.table_text` writes their scores.
"""
