// The loops of rows.h for one instruction set; KERNEL names it.
#include "rows.h"

namespace obbgs {
namespace KERNEL {

#define OBBGS_ADDRESS(name) rows::name,
extern const RowLoops row_loops = {OBBGS_ROW_LOOPS(OBBGS_ADDRESS)};

}  // namespace KERNEL
}  // namespace obbgs
