"""Identification: parameters, residuals, search, uncertainty."""

from sim2real import room

room(__name__)
