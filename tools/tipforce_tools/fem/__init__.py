"""Plane finite elements of the fingertip body with scikit-fem (``pip install "tipforce[fem]"``)."""
