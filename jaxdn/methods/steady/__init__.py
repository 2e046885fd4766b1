"""``steady``: a recurrent edge-stopping filter whose decisions are predicted by a network, in its own parts."""

from jaxdn.methods.steady import method as method
