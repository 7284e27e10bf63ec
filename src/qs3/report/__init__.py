"""Pictures of scans, clouds and runs, and one self-contained HTML page about a run or several."""
