/* What all of the library's sources share: numbers, and vectors of LANES of them. */
#include <math.h>
#include <stdint.h>
#include <string.h>

#ifdef DOUBLE
typedef double real;
typedef int64_t whole;
#define BYTES 8
#else
typedef float real;
typedef int32_t whole;
#define BYTES 4
#endif
#define ROUNDED(function, x) ((real)(BYTES == 8 ? function(x) : function##f((float)(x))))
#define FLOOR(x) ROUNDED(floor, x)
#define CEIL(x) ROUNDED(ceil, x)
#define SQRT(x) ROUNDED(sqrt, x)
#define LOG(x) ROUNDED(log, x)
#define HALF ((real)0.5)
#define ALPHA_MIN ((real)(1.0 / 255.0))
#define ALWAYS static inline __attribute__((always_inline))
