"""Structure-from-motion: from photographs to models."""
