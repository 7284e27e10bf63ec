"""Scores, records of runs, and tables made from records; no PyTorch."""

from qs3.evaluation.environment import git_commit as git_commit
from qs3.evaluation.environment import hardware as hardware
from qs3.evaluation.environment import versions as versions
from qs3.evaluation.metrics import MeanSEM as MeanSEM
from qs3.evaluation.metrics import SeedComparison as SeedComparison
from qs3.evaluation.metrics import accuracy as accuracy
from qs3.evaluation.metrics import class_mean_accuracy as class_mean_accuracy
from qs3.evaluation.metrics import compare_seeds as compare_seeds
from qs3.evaluation.metrics import confusion_matrix as confusion_matrix
from qs3.evaluation.metrics import mean_sem as mean_sem
from qs3.evaluation.metrics import per_class_accuracy as per_class_accuracy
from qs3.evaluation.metrics import wilson_interval as wilson_interval
from qs3.evaluation.records import DataRecord as DataRecord
from qs3.evaluation.records import RunRecord as RunRecord
from qs3.evaluation.records import Scores as Scores
from qs3.evaluation.records import append_record as append_record
from qs3.evaluation.records import read_records as read_records
from qs3.evaluation.records import score as score
