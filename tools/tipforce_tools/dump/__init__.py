"""`tipforce dump`: candump text, with the contact values of the frames."""
