"""The mappers: global, incremental and grown from an earlier model, their choice, and the completion of tracks."""
