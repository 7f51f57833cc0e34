"""The revision of how scans are measured.

Results that were kept are used again only where it is the same: it is raised whenever a scan would be measured
otherwise. tests/measure/test_revision.py fails where that was forgotten.
"""

MEASURE_REVISION = 13
