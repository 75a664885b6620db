// The hash-grid field at a point: nerf/kernels/torch/encoding.py, nerf/fields/mlp.py, nerf/fields/background.py.
// Defined: LEVELS, DIRECTIONS where colours depend on the direction, BACKGROUND_LEVELS where there is a background model.

const float MAX_LOG_DENSITY = 15.0;
const uvec3 PRIMES = uvec3(1u, 2654435761u, 805459861u);
const int TEXTURE_WIDTH = 2048; // of all tables: row r is the texel (r mod 2048, r / 2048)

uniform highp sampler2D table; // a row of four features per texel; scales of levels are in the density network
uniform highp usampler2D occupancy; // a brick of 4³ cells per texel: bits 0-31, bits 32-63, empty-space distance
uniform ivec4 levels[LEVELS]; // resolution, first row, mask of the hash (0: a dense level)

// A matrix for four inputs and four outputs each; j: four of the 64 hidden units.
layout(std140) uniform DensityNetwork {
    mat4 densityHidden[16 * LEVELS]; // [j LEVELS + level]
    mat4 densityOut[16 * 4]; // [4 j + four of the 16 geometry features]
};
layout(std140) uniform ColourNetwork {
    mat4 colourHidden[16 * 4]; // [4 j + four geometry features]
    mat4 colourDirection[16 * 4]; // [4 j + four harmonics]
    mat4 colourOut[16]; // [j]; three outputs
};

vec4 rowOf(highp sampler2D rows, int row) {
    return texelFetch(rows, ivec2(row % TEXTURE_WIDTH, row / TEXTURE_WIDTH), 0);
}

// The trilinear mean of the eight vertices around, on one level.
vec4 interpolated(highp sampler2D rows, ivec4 level, vec3 unit) {
    vec3 scaled = unit * float(level.x);
    vec3 cell = clamp(floor(scaled), 0.0, float(level.x - 1));
    vec3 w = scaled - cell;
    ivec4 columns; // (x, y), (x, y + 1), (x + 1, y), (x + 1, y + 1)
    ivec4 near;
    ivec4 far;
    if (level.z != 0) {
        uvec3 c = uvec3(cell) * PRIMES;
        uvec3 next = c + PRIMES;
        columns = ivec4(uvec4(c.x, c.x, next.x, next.x) ^ uvec4(c.y, next.y, c.y, next.y));
        near = (columns ^ int(c.z)) & level.z;
        far = (columns ^ int(next.z)) & level.z;
    } else {
        ivec3 c = ivec3(cell);
        int side = level.x + 1;
        columns = (c.x * side + c.y) * side + c.z + ivec4(0, side, side * side, side * side + side);
        near = columns;
        far = columns + 1;
    }
    near += level.y;
    far += level.y;
    vec4 weights = vec4(1.0 - w.x, 1.0 - w.x, w.x, w.x) * vec4(1.0 - w.y, w.y, 1.0 - w.y, w.y);
    return weights.x * mix(rowOf(rows, near.x), rowOf(rows, far.x), w.z)
        + weights.y * mix(rowOf(rows, near.y), rowOf(rows, far.y), w.z)
        + weights.z * mix(rowOf(rows, near.z), rowOf(rows, far.z), w.z)
        + weights.w * mix(rowOf(rows, near.w), rowOf(rows, far.w), w.z);
}

vec4 geometry[4]; // of the point seen last: 16 features, the first of which is the logarithm of the density
vec4 ofRay[16]; // what the viewing direction adds to the colour network's hidden layer, for all samples of a ray

void densityNetwork(vec3 unit) {
    vec4 features[LEVELS];
    for (int level = 0; level < LEVELS; ++level) features[level] = interpolated(table, levels[level], unit);
    for (int o = 0; o < 4; ++o) geometry[o] = vec4(0.0);
    for (int j = 0; j < 16; ++j) {
        vec4 hidden = vec4(0.0);
        for (int level = 0; level < LEVELS; ++level) hidden += densityHidden[j * LEVELS + level] * features[level];
        hidden = max(hidden, 0.0);
        for (int o = 0; o < 4; ++o) geometry[o] += densityOut[4 * j + o] * hidden;
    }
}

float densityOf(float logDensity) {
    return exp(min(logDensity, MAX_LOG_DENSITY));
}

void setDirection(vec3 d) {
    for (int j = 0; j < 16; ++j) ofRay[j] = vec4(0.0);
#ifdef DIRECTIONS
    vec3 s = d * d;
    vec4 harmonics[4];
    harmonics[0] = vec4(0.28209479177387814, -0.4886025119029199 * d.y, 0.4886025119029199 * d.z, -0.4886025119029199 * d.x);
    harmonics[1] = vec4(1.0925484305920792 * d.x * d.y, -1.0925484305920792 * d.y * d.z,
        0.31539156525252005 * (3.0 * s.z - 1.0), -1.0925484305920792 * d.x * d.z);
    harmonics[2] = vec4(0.5462742152960396 * (s.x - s.y), -0.5900435899266435 * d.y * (3.0 * s.x - s.y),
        2.890611442640554 * d.x * d.y * d.z, -0.4570457994644658 * d.y * (5.0 * s.z - 1.0));
    harmonics[3] = vec4(0.3731763325901154 * d.z * (5.0 * s.z - 3.0), -0.4570457994644658 * d.x * (5.0 * s.z - 1.0),
        1.445305721320277 * d.z * (s.x - s.y), -0.5900435899266435 * d.x * (s.x - 3.0 * s.y));
    for (int j = 0; j < 16; ++j)
        for (int o = 0; o < 4; ++o) ofRay[j] += colourDirection[4 * j + o] * harmonics[o];
#endif
}

// The colour of that point along that ray.
vec3 colourNetwork() {
    vec4 logits = vec4(0.0);
    for (int j = 0; j < 16; ++j) {
        vec4 hidden = ofRay[j];
        for (int o = 0; o < 4; ++o) hidden += colourHidden[4 * j + o] * geometry[o];
        logits += colourOut[j] * max(hidden, 0.0);
    }
    return 1.0 / (1.0 + exp(-logits.rgb));
}

#ifdef BACKGROUND_LEVELS
uniform highp sampler2D backgroundTable;
uniform ivec4 backgroundLevels[BACKGROUND_LEVELS];

// A colour for each direction, read where it meets the unit sphere.
vec3 backgroundModel(vec3 direction) {
    vec4 logits = vec4(0.0);
    for (int level = 0; level < BACKGROUND_LEVELS; ++level)
        logits += interpolated(backgroundTable, backgroundLevels[level], direction / 2.0 + 0.5);
    return 1.0 / (1.0 + exp(-logits.rgb));
}
#endif
