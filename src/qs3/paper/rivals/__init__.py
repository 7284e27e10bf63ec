"""Methods that the paper compares with: PointDAN, DefRec, DefRec+PCM, GAST."""
