"""Models and elements under the names that PyMJCF gives them: ``mjcf.from_path``, ``mjcf.RootElement`` and so on."""

from sim2real.composer.mjcf import element as element
from sim2real.composer.models.element import Element as Element
from sim2real.composer.models.mjcf.export import export_with_assets as export_with_assets
from sim2real.composer.models.mjcf.export import export_with_assets_as_zip as export_with_assets_as_zip
from sim2real.composer.models.mjcf.files import Asset as Asset
from sim2real.composer.models.model import Model as RootElement
from sim2real.composer.models.traversal import commit_defaults as commit_defaults
from sim2real.composer.models.traversal import get_attachment_frame as get_attachment_frame
from sim2real.composer.models.traversal import get_frame_freejoint as get_frame_freejoint
from sim2real.composer.models.traversal import get_frame_joints as get_frame_joints
from sim2real.composer.models.traversal import get_freejoint as get_freejoint
from sim2real.composer.physics.c.binding import Binding as Binding
from sim2real.composer.physics.c.physics import Physics as Physics

PREFIX_SEPARATOR = "/"
"""What stands between the names of models and of elements."""

from_xml_string = RootElement.from_xml_string
from_path = RootElement.from_path
from_file = RootElement.from_file
