"""Models and elements under the module in which PyMJCF has them."""

from sim2real.composer.models.element import Element as Element
from sim2real.composer.models.model import Model

RootElement = Model
