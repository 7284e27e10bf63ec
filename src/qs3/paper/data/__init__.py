"""Data sets that only the paper's tables read: ScanNet and NYU."""
