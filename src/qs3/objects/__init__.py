"""Objects out of a frame or a scene: what stands on its table, or what masks, COCO or BOP name."""
