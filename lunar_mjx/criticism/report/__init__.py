"""The criticism report: one offline page on a chain of runs."""

from lunar_mjx.criticism.report.write import write_report as write_report
