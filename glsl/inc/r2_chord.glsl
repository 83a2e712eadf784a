// Exact line integrals of a Gaussian of R2-Gaussian along pixels' own rays, in contrast to those of its affine picture in
// inc/r2.glsl. Lengths along its axes are in standard deviations. The including file must include "inc/r2.glsl". Reference
// implementation: src/methods/r2_gaussian/twin_chords.rs.

// Geometry of a Gaussian in a view.
struct R2Sight {
    float density;
    float depth;
    vec3 ray;           // ray through the centre, of unit depth
    mat3 along;         // that ray and its changes per column and row, along the Gaussian's axes
};

R2Sight sight_of(R2Gaussian g, vec2 mean, GaussianView view, GaussianSetup setup) {
    mat3 axes = rotation_matrix(normalize(g.rotation));
    vec3 scale = scale_of(g, setup);
    R2Sight s;
    s.density = density_of(g);
    s.depth = dot(view.depth, vec4(g.position, 1.0));
    s.ray = view.d0.xyz + mean.x * view.du.xyz + mean.y * view.dv.xyz;
    s.along = mat3((s.ray * axes) / scale, (view.du.xyz * axes) / scale, (view.dv.xyz * axes) / scale);
    return s;
}

// Line integral along a ray through a Gaussian, and its geometry.
struct R2Chord {
    vec3 nearest;       // vector from the centre to the ray's nearest point, along the axes
    vec3 direction;     // direction of the ray, along the axes, of unit length there
    float integral;
};

// Computes the chord of the ray at a distance of `d` columns and rows from the centre. The position of the ray at the centre's
// depth is small and exact, so that no large numbers are subtracted.
R2Chord chord_at(R2Sight s, GaussianView view, vec2 d) {
    vec3 beside = d.x * s.along[1] + d.y * s.along[2];
    vec3 b = s.along[0] + beside;
    float per_length = inversesqrt(dot(b, b));
    b *= per_length;
    vec3 a = s.depth * beside;
    vec3 c = a - dot(a, b) * b;
    float path = length(s.ray + d.x * view.du.xyz + d.y * view.dv.xyz) * per_length;
    return R2Chord(c, b, s.density * SQRT_TWO_PI * path * exp(-0.5 * dot(c, c)));
}

// Half sides, in pixels, of the box around the centre's pixel that contains all rays which pass within the cut.
vec2 chord_box(R2Projection p, GaussianView view, GaussianSetup setup) {
    vec3 far = p.at.scale * (view.depth.xyz * p.at.axes);
    vec3 column = p.at.scale * ((view.column.xyz - p.splat.mean.x * view.depth.xyz) * p.at.axes);
    vec3 row = p.at.scale * ((view.row.xyz - p.splat.mean.y * view.depth.xyz) * p.at.axes);
    float cut2 = setup.cut * setup.cut;
    float behind = p.at.depth * p.at.depth - cut2 * dot(far, far);
    // The Gaussian reaches the source, so the box contains all pixels.
    if (!(behind > 0.0)) return abs(p.splat.mean) + vec2(float(setup.width), float(setup.height));
    vec2 slant = cut2 * vec2(dot(far, column), dot(far, row));
    vec2 wide = cut2 * vec2(dot(column, column), dot(row, row));
    return (abs(slant) + sqrt(slant * slant + wide * behind)) / behind;
}
