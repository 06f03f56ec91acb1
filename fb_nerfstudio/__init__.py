"""The plugin: what speaks nerfstudio. Nothing is imported here but the table of earlier module names."""

from fb_nerfstudio.earlier_names import lead_earlier_names

lead_earlier_names()
