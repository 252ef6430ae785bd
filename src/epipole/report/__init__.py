"""The frame of the pages: templates, charts, the 3D view, the view from above, pictures. It knows scenes and no pipeline.

A pipeline's page is a sub-package: `page.py`, which gathers the values, and its template in `templates/`.
"""

from epipole.report.frame import render as render
from epipole.report.frame import render_piece as render_piece
