"""The interactive viewer: a page on this machine, with viser (extra ``view``).

What is shown, its colours, the errors and the live scan are plain functions that know nothing of
viser; `serving`, `canvas` and `pages` are the calls to it.
"""
