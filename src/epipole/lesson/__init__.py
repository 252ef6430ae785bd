"""The lesson: pages with something to move on each, offline, in English and Chinese, whose numbers are those of the library."""
