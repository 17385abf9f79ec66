"""Reports: offline HTML pages, one visual language for figures, and progress at the command line."""

from lunar_mjx.report.page import Explorer as Explorer
from lunar_mjx.report.page import Facts as Facts
from lunar_mjx.report.page import Figure as Figure
from lunar_mjx.report.page import Lead as Lead
from lunar_mjx.report.page import Pair as Pair
from lunar_mjx.report.page import Section as Section
from lunar_mjx.report.page import Table as Table
from lunar_mjx.report.page import Text as Text
from lunar_mjx.report.page import write_page as write_page
from lunar_mjx.report.progress import Reporter as Reporter
from lunar_mjx.report.progress import console_progress as console_progress
