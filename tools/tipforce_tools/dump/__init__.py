"""`tipforce dump`: candump's text, with the contact that the frames carry."""
