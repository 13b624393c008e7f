"""Identification: parameters, residuals, search, uncertainty."""
