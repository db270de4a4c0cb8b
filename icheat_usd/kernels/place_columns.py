"""What is known of places that lights shine on: numbers of the columns of a run of them."""

RUN = 64  #: successive places that share shadow rays if that is allowed
#: Columns of a run of places, one number for each: origin off the surface, geometric normal, shading normal, albedo
#: over pi; and where a place has a lobe, `specular`, `specular_edge`, alpha (0: no lobe), cosine to the eye, Smith's
#: Lambda of the eye, direction to the eye. The first ones of three, or the one.
ORIGIN, NORMAL, SHADING, TINT = 0, 3, 6, 9
SPECULAR, EDGE, ALPHA, COSINE, LAMBDA, EYE = 12, 15, 18, 19, 20, 21
COLUMNS = 24  #: of a run
