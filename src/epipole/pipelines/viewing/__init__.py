"""Whatever a folder holds, in the browser."""
