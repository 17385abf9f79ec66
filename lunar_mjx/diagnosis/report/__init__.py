"""The criticism report: one offline page on a chain of runs."""

from lunar_mjx.diagnosis.report.write import write_report as write_report
