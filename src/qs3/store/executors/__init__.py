"""Executors of a data set: this process, several processes, or a cluster."""

from qs3.store.executors.executor import Executor as Executor
from qs3.store.executors.executor import Failure as Failure
from qs3.store.executors.executor import InlineExecutor as InlineExecutor
from qs3.store.executors.executor import outcomes as outcomes
from qs3.store.executors.local import LocalExecutor as LocalExecutor
