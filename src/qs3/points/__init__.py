"""Point sets: sampling, outliers, clusters, planes. Sensor, readers and networks use them."""
