"""Selection of film transformation, distortion model and scanner terms."""
