"""The georeferencing job: control points and GPS give a finished model its position on Earth, its scale and its error bars."""
