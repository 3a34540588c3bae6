"""Found first on PYTHONPATH by every Python that a watched command starts: it reports to the file that the environment names."""

import os
import sys

if os.environ.get("PDAL_STAGES_AUDIT"):
    sys.path.append(os.path.join(os.path.dirname(__file__), ".."))
    try:
        import audit
    finally:
        sys.path.pop()
    audit.report_to(os.environ["PDAL_STAGES_AUDIT"])
