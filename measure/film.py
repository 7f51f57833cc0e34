"""What is believed of film and scanner before any mark is measured."""

SCATTER_MM = 0.005  # of a mark, along an axis: a project's film_sigma_um says it better
AFFINITY_SIGMA = 5e-3  # film stretches by a few parts in ten thousand, an office scanner by several thousandths
SCATTER_DEGREES = 4.0  # of freedom that it is known with: to a third
MOST_BENT_MM = 0.3  # beside an affine transformation
