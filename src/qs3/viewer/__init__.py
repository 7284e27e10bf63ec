"""The interactive viewer: a page on this machine, with viser (extra ``view``).

What is shown, its colours, the errors and the live scan are plain functions that know nothing of
viser; `serving`, `stage` and `pages` are the calls to it.
"""

from qs3.viewer.exhibits import Answers as Answers
from qs3.viewer.exhibits import ArrayExhibits as ArrayExhibits
from qs3.viewer.exhibits import Exhibit as Exhibit
from qs3.viewer.exhibits import Exhibits as Exhibits
from qs3.viewer.exhibits import StoreExhibits as StoreExhibits
from qs3.viewer.exhibits import single as single
from qs3.viewer.pages import gallery_page as gallery_page
from qs3.viewer.pages import scan_page as scan_page
from qs3.viewer.rescan import Outcome as Outcome
from qs3.viewer.rescan import Rescanner as Rescanner
from qs3.viewer.scan_controls import ScanControls as ScanControls
from qs3.viewer.scan_controls import ScanRequest as ScanRequest
from qs3.viewer.scan_controls import rescan as rescan
from qs3.viewer.serving import LOOPBACK as LOOPBACK
from qs3.viewer.serving import bind as bind
from qs3.viewer.serving import is_loopback as is_loopback
from qs3.viewer.serving import require_viser as require_viser
from qs3.viewer.serving import serve as serve
from qs3.viewer.serving import url_of as url_of
