"""One file a table or figure, with an ``EXPERIMENT``; the file's name is the table's.

Its command is ``qs3 reproduce NAME --out DIR``; with ``--dry-run`` it prints counts.
"""
