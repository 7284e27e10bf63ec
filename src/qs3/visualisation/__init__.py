"""Pictures of scans, clouds and training runs, drawn without a display."""

from qs3.visualisation.clouds import SIDES as SIDES
from qs3.visualisation.clouds import draw_cloud as draw_cloud
from qs3.visualisation.clouds import gallery as gallery
from qs3.visualisation.clouds import project as project
from qs3.visualisation.clouds import samples_per_class as samples_per_class
from qs3.visualisation.embedding import embed as embed
from qs3.visualisation.embedding import feature_map as feature_map
from qs3.visualisation.figure import png_bytes as png_bytes
from qs3.visualisation.figure import write_png as write_png
from qs3.visualisation.montage import MontageView as MontageView
from qs3.visualisation.montage import montage as montage
from qs3.visualisation.montage import object_box as object_box
from qs3.visualisation.plots import Curve as Curve
from qs3.visualisation.plots import SelectionRound as SelectionRound
from qs3.visualisation.plots import class_accuracy as class_accuracy
from qs3.visualisation.plots import confusion_heatmap as confusion_heatmap
from qs3.visualisation.plots import selection_counts as selection_counts
from qs3.visualisation.plots import training_curves as training_curves
from qs3.visualisation.realism import REALISM_PLOTS as REALISM_PLOTS
from qs3.visualisation.realism import realism_plot as realism_plot
