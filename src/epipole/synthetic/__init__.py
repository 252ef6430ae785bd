"""Synthetic scenes with exact poses and depth, and geometry problems with known answers."""

from epipole.synthetic.courtyard import courtyard as courtyard
from epipole.synthetic.courtyard import courtyard_views as courtyard_views
from epipole.synthetic.courtyard import look_at as look_at
from epipole.synthetic.render import Rendering as Rendering
from epipole.synthetic.render import render as render
from epipole.synthetic.render import render_exposures as render_exposures
from epipole.synthetic.scene import Box as Box
from epipole.synthetic.scene import HeightField as HeightField
from epipole.synthetic.scene import Plane as Plane
from epipole.synthetic.scene import Sphere as Sphere
from epipole.synthetic.scene import SyntheticScene as SyntheticScene
from epipole.synthetic.scene import Texture as Texture
