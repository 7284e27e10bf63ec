"""Clouds in memory, and the readers and writers of files, data sets and scans."""

from qs3.clouds.files import read_cloud as read_cloud
from qs3.clouds.load import load_clouds as load_clouds
from qs3.clouds.load import load_unlabelled as load_unlabelled
from qs3.clouds.preparation import PAPER as PAPER
from qs3.clouds.preparation import ROBUST as ROBUST
from qs3.clouds.preparation import Preparation as Preparation
from qs3.clouds.types import CloudKind as CloudKind
from qs3.clouds.types import PointClouds as PointClouds
from qs3.clouds.types import UnlabelledClouds as UnlabelledClouds
from qs3.meshes.classes import POINTDA10 as POINTDA10
from qs3.meshes.classes import canonical as canonical
from qs3.meshes.classes import map_labels as map_labels
from qs3.reading import reading as reading
