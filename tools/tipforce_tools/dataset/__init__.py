"""`tipforce dataset`: what a dataset holds, whether it is whole, and questions to it."""
