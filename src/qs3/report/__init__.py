"""One self-contained HTML page about one run or several."""

from qs3.report.page import render as render
from qs3.report.page import write_report as write_report
from qs3.report.records import Cloud as Cloud
from qs3.report.records import DataLine as DataLine
from qs3.report.records import FeatureMap as FeatureMap
from qs3.report.records import Outcome as Outcome
from qs3.report.records import Report as Report
from qs3.report.scores import NamedRecord as NamedRecord
from qs3.report.scores import ScoreLine as ScoreLine
from qs3.report.scores import score_lines as score_lines
from qs3.report.verdict import Verdict as Verdict
from qs3.report.verdict import judge as judge
