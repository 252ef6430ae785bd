"""Building blocks of HTML pages: templates, charts, 3D view, view from above, images. Independent of any pipeline.

A pipeline's page is a sub-package: `page.py`, which collects the values, and its template in `templates/`.
"""

from epipole.report.frame import render as render
from epipole.report.frame import render_piece as render_piece
