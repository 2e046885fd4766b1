"""``combiner``: a network that combines Open Image Denoise with what the samples and earlier frames tell, in parts."""

from jaxdn.methods.combiner import method as method
