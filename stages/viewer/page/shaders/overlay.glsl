// What is drawn over the picture: the picture itself (QUAD), lines and points (else).
#ifdef VERTEX
#ifdef QUAD
out vec2 at;
void main() {
    at = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0;
    gl_Position = vec4(at * 2.0 - 1.0, 0.0, 1.0);
}
#else
uniform mat4 clipFromScene;
uniform float pointSize;
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 colour;
out vec3 tint;
void main() {
    gl_Position = clipFromScene * vec4(position, 1.0);
    gl_PointSize = pointSize;
    tint = colour;
}
#endif
#else
out vec4 shown;
#ifdef QUAD
uniform highp sampler2D picture;
in vec2 at;
void main() {
    shown = vec4(texture(picture, at).rgb, 1.0);
}
#else
in vec3 tint;
void main() {
    shown = vec4(tint, 1.0);
}
#endif
#endif
