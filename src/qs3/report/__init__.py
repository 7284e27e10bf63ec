"""Pictures of scans, clouds and runs, and self-contained HTML pages.

`page` makes ``report.html`` about a run, and `parts_page` makes ``parts.html``: scan by
scan, with its CAD over it.
"""
