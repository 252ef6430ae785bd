"""The lesson: interactive offline pages in English and Chinese whose numbers are those of the library."""
