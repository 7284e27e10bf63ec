"""One file a table or figure, with an ``EXPERIMENT``; its name is that of the file.

Its command is ``qs3 reproduce NAME --out DIR``; with ``--dry-run`` it prints counts and hours.
"""
