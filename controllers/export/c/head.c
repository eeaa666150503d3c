/* The controller's code. C99 with <math.h> alone: no heap, no files, no globals that change.
 *
 * The arithmetic is that of the Python package `controllers` it was written from, in float. Its
 * interface is in coax_controller.h, its numbers are in coax_numbers.h. Do not compile with
 * -ffast-math: the checks for readings that are no numbers would be left out.
 */
#include "coax_controller.h"
#include "coax_numbers.h"

#include <math.h>

#define PI 3.14159265358979f
#define LEAST_DISTANCE 1e-9f /* [m] below which a direction is not asked for */

enum { FORWARD, RIGHT, UP, TURN };
enum { NORTH, EAST, DOWN, HEADING };
enum { AXIS_PLACE, AXIS_HEIGHT, AXIS_HEADING, AXES }; /* of a setpoint */

/* An angle [rad] in [-pi, pi). */
static float wrapped(float angle)
{
    return angle - 2.0f * PI * floorf((angle + PI) / (2.0f * PI));
}

static float within(float value, float low, float high)
{
    return value < low ? low : (value > high ? high : value);
}

/* A horizontal vector turned clockwise, seen from above, by an angle [rad]; in place. */
static void turn(float *first, float *second, float angle)
{
    const float cosine = cosf(angle), sine = sinf(angle), forward = *first, right = *second;
    *first = cosine * forward - sine * right;
    *second = sine * forward + cosine * right;
}
