"""One self-contained HTML page about a run."""

from qs3.report.page import render as render
from qs3.report.page import write_report as write_report
from qs3.report.records import Outcome as Outcome
from qs3.report.records import Report as Report
from qs3.report.verdict import Verdict as Verdict
from qs3.report.verdict import judge as judge
