"""Where the work of a data set is done: in this process, in several, or on a cluster."""

from qs3.datasets.executors.executor import Executor as Executor
from qs3.datasets.executors.executor import Failure as Failure
from qs3.datasets.executors.executor import guarded as guarded
from qs3.datasets.executors.inline import InlineExecutor as InlineExecutor
from qs3.datasets.executors.local import LocalExecutor as LocalExecutor
