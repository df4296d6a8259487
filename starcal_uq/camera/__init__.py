"""The camera and its one formula."""
