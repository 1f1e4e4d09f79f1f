"""Judging captures: do they hold what training needs, and do several cameras agree."""
