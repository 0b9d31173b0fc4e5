"""Pages for people: reports, comparisons, detections, and their figures."""
