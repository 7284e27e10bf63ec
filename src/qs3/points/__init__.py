"""Point sets: sampling, outliers and planes. The sensor, the readers and the networks use them."""
