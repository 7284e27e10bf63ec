"""Objects cut from real scans: from RGB-D sequences, single depth images and fused meshes."""
