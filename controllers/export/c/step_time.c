/* Time per control period and memory of the controller, on the machine that runs this. */
#include "coax_controller.h"

#include <stdio.h>
#include <time.h>

#define STEPS 200000

int main(void)
{
    static coax_controller c;
    float observation[COAX_OBSERVED] = {0.0f}, action[COAX_COMMANDS], command[COAX_COMMANDS];
    const float *way = COAX_HAS_TARGET ? (const float[4]){0.1f, 0.1f, 0.0f, 0.0f} : 0;
    float sum = 0.0f;
    clock_t begin;

    coax_reset(&c);
    begin = clock();
    for (int k = 0; k < STEPS; k++) {
        for (int i = 0; i < COAX_OBSERVED; i++) /* small, and never twice the same */
            observation[i] = 1e-3f * (float)((k * 31 + i * 17) % 101);
        coax_step(&c, observation, way, action, command);
        sum += command[0];
    }
    printf("%.4f us per step, %lu bytes per controller, checksum %g\n",
           1e6 * (double)(clock() - begin) / CLOCKS_PER_SEC / STEPS, (unsigned long)sizeof c,
           (double)sum);
    return 0;
}
