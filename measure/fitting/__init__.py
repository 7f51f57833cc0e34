"""One mark measured to the noise of the film, by least-squares matching."""
