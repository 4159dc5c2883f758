"""The back end as a node."""

from vli_common.stop_signals import take_over_in_nodes

take_over_in_nodes(__name__)
