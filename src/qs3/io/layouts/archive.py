"""NumPy archives of clouds as a layout to convert from."""

from qs3.io.layouts.format import Format
from qs3.io.npz import read_npz

FORMAT = Format(
    name="npz",
    layout="one NumPy archive with points [b n 3], label, class_names, is_train and name",
    detect=lambda path: path.suffix.lower() == ".npz" and path.is_file(),
    read=read_npz,
)
