"""Figures of clouds, captures and grades by matplotlib: no display, no graphics card, no state that pyplot keeps."""
