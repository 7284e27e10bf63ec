"""Names of classes: PointDA-10's ten with their aliases, ModelNet40's, ShapeNetCore's synsets.

Convention:
    The ten classes of PointDA-10 in alphabetical order are the common tongue of all data sets.
"""

import re

POINTDA10: tuple[str, ...] = (
    "bathtub",
    "bed",
    "bookshelf",
    "cabinet",
    "chair",
    "lamp",
    "monitor",
    "plant",
    "sofa",
    "table",
)

_ALIASES: dict[str, tuple[str, ...]] = {
    "bathtub": ("bath", "bath_tub", "tub"),
    "bookshelf": ("shelf", "bookcase", "book_shelf", "shelves"),
    "cabinet": (
        "night_stand",
        "nightstand",
        "bedside_table",
        "dresser",
        "wardrobe",
        "cupboard",
        "chest_of_drawers",
        "file_cabinet",
        "filing_cabinet",
    ),
    "chair": (
        "armchair",
        "arm_chair",
        "office_chair",
        "swivel_chair",
        "stool",
        "bar_stool",
        "barstool",
        "bench",
    ),
    "lamp": ("floor_lamp", "desk_lamp", "table_lamp", "light"),
    "monitor": ("television", "tv", "tv_monitor", "tvmonitor", "display", "screen"),
    "plant": ("potted_plant", "pottedplant", "house_plant", "houseplant"),
    "sofa": ("couch", "settee", "loveseat"),
    "table": ("desk", "dining_table", "diningtable", "coffee_table", "side_table", "end_table"),
}
_CANONICAL = {alias: name for name, aliases in _ALIASES.items() for alias in aliases}


def canonical(name: str) -> str:
    """Fold case, spaces and hyphens, and replace an alias by its class of PointDA-10.

    A name that is in no row of the table comes back folded.

    Example:
        >>> canonical("Night Stand"), canonical("TV-monitor"), canonical("toilet")
        ('cabinet', 'monitor', 'toilet')
    """
    folded = re.sub(r"[\s_-]+", "_", name.strip().lower())
    return _CANONICAL.get(folded, folded)


_MODELNET40 = """
airplane bathtub bed bench bookshelf bottle bowl car chair cone cup curtain desk door dresser
flower_pot glass_box guitar keyboard lamp laptop mantel monitor night_stand person piano plant
radio range_hood sink sofa stairs stool table tent toilet tv_stand vase wardrobe xbox
"""
MODELNET40: frozenset[str] = frozenset(_MODELNET40.split())
"""Folders of ModelNet40; ModelNet10's are among them."""

POINTDA10_OF_MODELNET: dict[str, str] = {
    "night_stand" if name == "cabinet" else name: name for name in POINTDA10
}
"""ModelNet40's share of PointDA-10: ten folders, of which only night_stand gets another name.

4,183 meshes to train on and 856 to test on; Qin et al., PointDAN, NeurIPS 2019.
"""

SHAPENET: dict[str, str] = {
    "02691156": "airplane",
    "02747177": "ashcan",
    "02773838": "bag",
    "02801938": "basket",
    "02808440": "bathtub",
    "02818832": "bed",
    "02828884": "bench",
    "02843684": "birdhouse",
    "02871439": "bookshelf",
    "02876657": "bottle",
    "02880940": "bowl",
    "02924116": "bus",
    "02933112": "cabinet",
    "02942699": "camera",
    "02946921": "can",
    "02954340": "cap",
    "02958343": "car",
    "02992529": "cellular_telephone",
    "03001627": "chair",
    "03046257": "clock",
    "03085013": "computer_keyboard",
    "03207941": "dishwasher",
    "03211117": "display",
    "03261776": "earphone",
    "03325088": "faucet",
    "03337140": "file",
    "03467517": "guitar",
    "03513137": "helmet",
    "03593526": "jar",
    "03624134": "knife",
    "03636649": "lamp",
    "03642806": "laptop",
    "03691459": "loudspeaker",
    "03710193": "mailbox",
    "03759954": "microphone",
    "03761084": "microwave",
    "03790512": "motorcycle",
    "03797390": "mug",
    "03928116": "piano",
    "03938244": "pillow",
    "03948459": "pistol",
    "03991062": "pot",
    "04004475": "printer",
    "04074963": "remote_control",
    "04090263": "rifle",
    "04099429": "rocket",
    "04225987": "skateboard",
    "04256520": "sofa",
    "04330267": "stove",
    "04379243": "table",
    "04401088": "telephone",
    "04460130": "tower",
    "04468005": "train",
    "04530566": "vessel",
    "04554684": "washer",
}
"""ShapeNetCore's 55 synsets: WordNet 3.0 offset → the synset's first name."""

POINTDA10_OF_SHAPENET: dict[str, str] = {
    "display": "monitor",
    "pot": "plant",
    **{name: name for name in POINTDA10 if name not in ("monitor", "plant")},
}
"""ShapeNetCore's share of PointDA-10, by the names of ``SHAPENET``; pot is a flowerpot's synset."""
