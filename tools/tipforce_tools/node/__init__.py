"""`tipforce node`: run one fingertip node."""
