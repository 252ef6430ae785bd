"""Radiance fields: scenes that are drawn, and learnt from pictures, by their colour and density in space."""

from epipole.fields.rasterizer import Rendering as Rendering
from epipole.fields.rasterizer import RenderOptions as RenderOptions
from epipole.fields.rasterizer import render as render
